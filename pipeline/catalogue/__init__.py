"""What scenes are dressed with: textures and objects, from packages, downloads, procedures and folders of one's own."""
