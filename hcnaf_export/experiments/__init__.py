"""Comparisons on real recordings, each by one command that can be interrupted and writes its own record."""
