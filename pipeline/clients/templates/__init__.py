"""Files that are copied as they are beside a dataset and run in the environments of the policies that train on it."""
