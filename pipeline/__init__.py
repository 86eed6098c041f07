"""Perturbed robot fine-tuning data from LIBERO demonstrations."""
