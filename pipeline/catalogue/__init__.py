"""Textures and objects for scenes: from installed packages, downloads, generators and the user's own folders."""
