"""Main lenses: thin, telecentric, and real ones, each as rays and as waves pass it."""
