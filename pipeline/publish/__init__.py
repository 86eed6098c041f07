"""What is sent: the card of a dataset, what it owes to whom, and the upload."""
