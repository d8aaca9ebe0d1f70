"""Define the measurements of a part, evaluate them in clouds, and predict their uncertainty before any capture."""
