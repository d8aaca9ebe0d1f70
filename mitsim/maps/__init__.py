"""Performance maps: made from captures of coupons, and used to predict clouds."""
