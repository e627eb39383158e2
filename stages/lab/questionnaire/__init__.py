"""Questionnaire on films: pages for participants, and evaluation of their answers."""
