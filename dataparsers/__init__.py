"""Dataset formats, one file each. Nothing outside this package knows a dataset's layout."""
