"""From a CAD file to a scene, and what will surprise in one."""
