"""Results of campaigns: text, files, figures, a page, and the folder that keeps finished runs."""
