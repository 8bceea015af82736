"""Captures on disk: folders (`folder`), their images (`images`), a quick check of both (`check`)."""
