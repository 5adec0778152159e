"""Storages: what a pixel does with the fragments that it is given."""
