"""Environments with traps for whoever runs them otherwise than alone, from their start to their end.

`worlds` are what the traps of `kinds` are planted in, `pilots` drive through them, and `judge` compares.
"""
