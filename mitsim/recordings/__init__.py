"""Other programs' and devices' recordings, read as captures."""
