"""Your own data as CSV files: reader and settings."""
