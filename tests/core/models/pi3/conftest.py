from tests.core.models.pi3.recordings import manifest, recorded  # noqa: F401
