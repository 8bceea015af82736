"""Decoding of Gray and plain binary codes: decoding, of bit_words, with sequence_checks."""
