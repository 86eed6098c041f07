"""Files that are copied unchanged next to a dataset and run in the environments of the policies that train on it."""
