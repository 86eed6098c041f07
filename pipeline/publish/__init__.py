"""What a finished run is shown and shared by: report, card, fine-tuning recipe, upload."""
