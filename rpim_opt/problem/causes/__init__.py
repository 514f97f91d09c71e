"""Likely causes of a poor fit."""
