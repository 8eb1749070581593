"""Verification compiles many programs and runs each once."""

import verified

quickly = verified.quickly
