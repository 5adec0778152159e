"""Fragments to layers."""
