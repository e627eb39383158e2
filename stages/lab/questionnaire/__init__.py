"""Questionnaire on films: pages for participants, and the table of their answers."""
