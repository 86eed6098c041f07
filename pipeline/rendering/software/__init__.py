"""Savings of software rendering: the same pixels with less work for Mesa."""
