"""Recipes and templates for the training codes that read the datasets, and checks that read like these codes."""
