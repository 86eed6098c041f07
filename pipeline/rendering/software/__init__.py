"""Savings of software rendering: the same pixels with less for Mesa to draw."""
