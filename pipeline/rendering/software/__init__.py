"""Savings of software rendering: equal pixels with less work for Mesa."""
