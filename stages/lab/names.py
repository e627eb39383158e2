"""Options that list names, separated by commas."""

from collections.abc import Collection

from stages.core.errors import InputError


def chosen_names(text: str, known: Collection[str], option: str = "--only") -> list[str]:
    """The names that an option lists, or all known ones for an empty text. Raises InputError for an unknown name."""
    names = [name.strip() for name in text.split(",") if name.strip()] or list(known)
    for name in names:
        if name not in known:
            raise InputError(f"{option} {name}: choose from {', '.join(known)}")
    return names
