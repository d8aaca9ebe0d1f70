"""Share errors, documents and file access between both packages: bounded reading, atomic writing."""
