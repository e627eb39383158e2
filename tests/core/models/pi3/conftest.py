from tests.core.models.pi3.recorded import manifest, recorded  # noqa: F401
