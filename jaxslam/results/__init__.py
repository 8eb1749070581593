"""Results of campaigns: tables, files, figures, an HTML page, and the folder of finished runs."""

__all__ = ["plot", "report", "store"]
