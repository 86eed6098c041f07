"""What is looked at: the report of a run, contact sheets, previews, and the report of evaluations."""
