"""The project's own proofs: statements, scores, maps and losses compared with independent measurements."""
