"""Training scripts of other projects on our task; their packages are imported where used."""
