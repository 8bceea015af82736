"""Decoding of phase-shifted waves."""
