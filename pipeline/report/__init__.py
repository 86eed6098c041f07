"""Pages and pictures for people: the report of a run, contact sheets, previews, and the report of evaluations."""
