"""Checks that read finished datasets as their clients do, and report errors."""
