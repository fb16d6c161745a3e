"""What the numbers should be, in up to 60 digits, by ways that share nothing with the compiled code."""
