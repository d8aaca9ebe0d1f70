"""How the program runs: worker processes and clusters, limits of time, the build of a process."""
