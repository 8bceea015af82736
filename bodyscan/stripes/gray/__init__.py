"""Decoding of Gray and plain binary codes."""
