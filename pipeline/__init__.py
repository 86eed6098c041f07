"""Perturbed, success-checked, fully labelled fine-tuning data from LIBERO demonstrations."""
