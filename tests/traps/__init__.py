"""Environments with traps for whoever runs them otherwise than alone, from their start to their end.

The traps of `kinds` are planted in `worlds` after `plans`; `pilots` drive through them, and `judge` compares.
"""
