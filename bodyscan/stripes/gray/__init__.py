"""Decoding of Gray and plain binary codes: bit_patterns, of bit_words, with sequence_checks."""
