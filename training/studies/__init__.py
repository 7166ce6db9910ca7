"""Studies: small networks trained side by side to compare one choice at a time."""
