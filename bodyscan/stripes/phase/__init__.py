"""Decoding of phase-shifted waves, and of what the projector's response does to them."""
