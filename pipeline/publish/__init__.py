"""Content for the hub: the card of a dataset, its attributions, and the upload."""
