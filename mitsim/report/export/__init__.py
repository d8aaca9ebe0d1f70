"""Write mitsim's results as files of other programs: clouds, scenes, results, targets, maps and data sets."""
