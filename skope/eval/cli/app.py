"""`skope eval` and its subcommands."""

from skope.eval.cli.camera import estimate_camera
from skope.eval.cli.evaluate import calibrate_scores, compare_runs, evaluate_or_score, view
from skope.eval.cli.predict import predict
from skope.eval.cli.site import site
from skope.eval.cli.station import station
from skope.eval.cli.track import pose, track
from skope.eval.cli.traffic import traffic
from skope.terminal.command_options import Commands

app = Commands(help="Measure a detector: PCK, precision and recall over IoU 0.6 to 0.9, COCO AP.")
app.callback(invoke_without_command=True)(evaluate_or_score)
app.command(name="compare")(compare_runs)
app.command(name="calibrate-scores")(calibrate_scores)
app.command(name="predict")(predict)
app.command(name="pose")(pose)
app.command(name="track")(track)
app.command(name="traffic")(traffic)
app.command(name="camera")(estimate_camera)
app.command(name="view")(view)
app.command(name="site")(site)
app.command(name="station")(station)
