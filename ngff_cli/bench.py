"""`ngff-lab bench`: benchmarks of quality and speed, each with a baseline that is measured in the same run."""

from ngff_cli import bench_motion, bench_scenes, bench_speed
from ngff_cli.options import new_app

app = new_app()


@app.callback()
def _bench() -> None:
    """Run a benchmark; each also measures a baseline in the same run."""


for _part in (bench_scenes, bench_motion, bench_speed):
    app.add_typer(_part.app)
