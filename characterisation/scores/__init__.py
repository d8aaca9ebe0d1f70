"""How good views are for a task, which of them together, and whether such scores are right."""
