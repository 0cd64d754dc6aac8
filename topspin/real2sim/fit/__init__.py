"""Fitting recorded tracks: bounces, launch, spin, drag and lift."""
