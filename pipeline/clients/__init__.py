"""What the training codes that read the datasets expect: recipes, templates, and checks that read as they do."""
