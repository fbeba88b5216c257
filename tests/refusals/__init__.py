"""What is refused, one table a package: rows of a call, or what it is given, and words of what it says."""
