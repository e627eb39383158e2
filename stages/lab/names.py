"""Parsing of options that list names separated by commas."""

from collections.abc import Collection

from stages.core.errors import InputError


def chosen_names(text: str, known: Collection[str], option: str = "--only") -> list[str]:
    """The names listed in an option, or all known names if the text is empty. Raises InputError for unknown names."""
    names = [name.strip() for name in text.split(",") if name.strip()] or list(known)
    for name in names:
        if name not in known:
            raise InputError(f"{option} {name}: choose from {', '.join(known)}")
    return names
