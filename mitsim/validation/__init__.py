"""What was foretold, held against what is then seen: view scores against measurements from many views."""
