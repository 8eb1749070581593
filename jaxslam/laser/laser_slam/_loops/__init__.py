"""Loop closing: candidates by position and by appearance, their matches, and their agreement."""
