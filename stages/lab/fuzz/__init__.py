"""Fuzzing of file readers: small valid files of every format, with random damage."""
