"""Decode images to points, by technique. Decoders know only images and a rig."""
