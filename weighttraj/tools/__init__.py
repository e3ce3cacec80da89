"""What one does with data that are already there: verify, repair, lint, pack, export, tables."""
