"""What keeps a map in order: duplicates merged, loops closed, a lost robot found again."""
