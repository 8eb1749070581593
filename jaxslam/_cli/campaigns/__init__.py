"""Commands that run Monte-Carlo campaigns."""
