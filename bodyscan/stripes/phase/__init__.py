"""Decoding of phase-shifted waves.

decoding: waves, their phase_order, and the projector_response that bends them.
"""
