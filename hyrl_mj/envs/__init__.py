"""Environments: one batched core, and its faces for Gymnasium and Stable-Baselines3."""
