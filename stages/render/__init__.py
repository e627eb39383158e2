"""Stage render: trajectory or scene -> video or image."""
