"""What is measured in clouds without a study: features in windows, plates of dots, tasks, differences of clouds."""
