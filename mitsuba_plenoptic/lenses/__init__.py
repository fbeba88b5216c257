"""Main lenses: thin, telecentric, collimated and real ones, each for rays and for waves."""
