"""What was predicted, held against what is then seen: view scores against measurements from many views."""
