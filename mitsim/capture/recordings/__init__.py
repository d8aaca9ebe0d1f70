"""Read recordings of other programs and devices as captures."""
