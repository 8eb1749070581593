"""Loop closing: candidates by place and by looks, their matches, and which of them agree."""
