"""Captures: what they are, how they are simulated, read from makers' files, kept in folders and decoded."""
