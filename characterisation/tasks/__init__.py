"""What is to be measured on a part, the measuring of it, and the uncertainty to expect before anything is captured."""
