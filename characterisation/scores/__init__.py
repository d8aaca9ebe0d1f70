"""Score and rank views for a task, choose sets of views, and test the scores against true errors."""
