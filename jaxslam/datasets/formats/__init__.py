"""Readers and writers of file formats, with errors that name the place."""
