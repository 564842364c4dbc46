"""Other people's training scripts on our task; torch and their packages are imported where used."""
