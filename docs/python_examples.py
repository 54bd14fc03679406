"""Examples of the Python reference: a short program for each public name.

Lines that begin with `#>` are the output. `tests/test_python_examples.py` runs each program in a folder that
has a video, its camera, a site, an image, a dataset and a file of predictions.
"""

from typing import Final

EXAMPLES: Final = {
    "calibrate_camera": """
import numpy as np
import skope

pixels = np.array([[759, 674], [1180, 631], [768, 550], [1168, 509], [898, 473], [1027, 446], [749, 492]])
places = np.array([[12, 4, 0], [14, -5, 0], [20, 6, 0], [25, -8, 0], [32, 3, 0], [40, -4, 0], [28, 9, 0]])
calibration = skope.calibrate_camera((pixels, places), size=(1920, 1080))
print(f"{calibration.camera.position[2]:.1f} m above the road, {len(calibration.outliers)} wrong points")
#> 6.5 m above the road, 0 wrong points
""",
    "count": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
for row in skope.count(tracks, "site.toml"):
    if row.class_name == "vehicle" and row.lane == "all" and row.direction != "all":
        print(row.gate, row.direction, row.count, row.confidence_interval)
""",
    "estimate_poses": """
import skope

found = skope.load_detector()("noon.jpg").above(0.5)
located = skope.estimate_poses(found, skope.read_camera("camera.json"))
print(located.poses.position[located.good].round(1))  # metres
print(located.poses.refusal)  # the reason for a missing pose, or None
""",
    "generate": """
import skope

dataset = skope.generate("data/rain", sites=["t01_mill_corner"], frames=2, size=(320, 180), weather="rain")
print(dataset.splits, [image.record.file_name for image in dataset])
""",
    "load_detector": """
import skope

detector = skope.load_detector("road33", device="cpu")
found = detector("noon.jpg")
print(len(found), found.boxes_xyxy.shape, found.keypoints.shape)
#> 2 (2, 4) (2, 33, 3)
""",
    "measure_traffic": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
report = skope.measure_traffic(tracks, "site.toml")
for crossing in report.crossings:
    print(f"{crossing.gate} at {crossing.time_s:.1f} s: {crossing.speed:.1f} m/s")
""",
    "open_dataset": """
import skope

dataset = skope.open_dataset("data/roads")
for split in dataset.splits:
    print(split, len(dataset.read(split).images))
#> easy 2
#> train 2
""",
    "read_camera": """
import skope

camera = skope.read_camera("camera.json")
print(camera.width, camera.height, camera.position)
#> 640 360 [ 3. -2.  7.]
""",
    "read_image": """
import skope

pixels = skope.read_image("noon.jpg")  # RGB
print(pixels.shape, pixels.dtype)
#> (360, 640, 3) uint8
""",
    "read_site": """
import skope

site = skope.read_site("site.toml")
print([gate.name for gate in site.gates])
#> ['gate']
""",
    "save_camera": """
import skope

camera = skope.Camera.looking([2, 5, 7], yaw=0.5, pitch_down=0.3, size=(1280, 720))
skope.save_camera("made.json", camera)
print(skope.read_camera("made.json").position.round(3))
#> [2. 5. 7.]
""",
    "score": """
import skope

scores = skope.score("predictions.json", "data/roads/annotations/easy.json")
print(scores["iou"]["0.6"]["pck"])
#> 1.0
""",
    "torch_dataset": """
import skope

pixels, target = skope.torch_dataset("data/roads", "train")[0]
print(tuple(pixels.shape), tuple(target["boxes"].shape), tuple(target["keypoints"].shape))
#> (3, 120, 160) (2, 4) (2, 33, 3)
""",
    "track": """
import skope

detector, camera = skope.load_detector(), skope.read_camera("camera.json")
located, times_s = [], []
for frame in detector.video("crossing.mp4", every_frame=True):
    located.append(skope.estimate_poses(frame.detections.above(0.9), camera))
    times_s.append(frame.time_s)
for track in skope.track(located, times_s):
    print(track.number, track.position[0].round(1), track.speed.max().round(1))
""",
    "train_detector": """
import skope

checkpoint = skope.train_detector("data/roads", "runs/roads", epochs=1)
print(checkpoint.suffix)
#> .safetensors
""",
    "Camera": """
import skope

camera = skope.Camera.looking([0, 0, 7], yaw=0.0, pitch_down=0.3, size=(1280, 720))
pixels, depth_m, valid = camera.project([[20, 0, 0], [20, 3, 0]])
print(pixels.round(), valid)
""",
    "Detections": """
import skope

found = skope.load_detector()("noon.jpg")
large = found[found.boxes_xyxy[:, 3] - found.boxes_xyxy[:, 1] > 40]  # a mask, a slice or an index
print(len(large.above(0.5)), "large vehicles")
found.save("found.json")  # COCO results
""",
    "Detector": """
import skope

detector = skope.load_detector()
print(detector.categories)
for found in detector.detect_batch(["noon.jpg", "noon.jpg"]):
    print(len(found), found.size)
#> ('vehicle',)
#> 2 (640, 360)
#> 2 (640, 360)
""",
    "UserError": """
import skope

try:
    skope.read_site("none.toml")
except skope.UserError as error:
    print(error)
#> none.toml: no such file
""",
    "Video": """
import skope

video = skope.load_detector().video("crossing.mp4", end_s=0.5)
print(video.fps, [round(frame.time_s, 1) for frame in video])
#> 10.0 [0.0, 0.1, 0.2, 0.3, 0.4]
""",
    "VideoFrame": """
import skope

for frame in skope.load_detector().video("crossing.mp4", end_s=0.2):
    skope.draw.write(f"seen_{frame.index}.jpg", frame.draw())
    print(frame.index, frame.name, frame.image.shape, len(frame.detections))
#> 0 crossing/000000 (360, 640, 3) 2
#> 1 crossing/000001 (360, 640, 3) 2
""",
    "Dataset": """
import skope

dataset = skope.open_dataset("data/roads")
print(dataset.splits, dataset.categories, sum(len(image.annotations) for image in dataset))
#> ('easy', 'train') ('vehicle',) 8
""",
    "LabelledImage": """
import skope

image = next(iter(skope.open_dataset("data/roads")))
print(image.split, image.record.file_name, image.pixels().shape, image.camera.position)
print([vehicle.vehicle_type for vehicle in image.annotations])
""",
    "RoadUserDetections": """
import skope

people = skope.load_detector()("noon.jpg").road_users
print(people.boxes_xyxy.shape, people.scores.shape, people.categories.shape)
#> (0, 4) (0,) (0,)
""",
    "Located": """
import skope

located = skope.estimate_poses(skope.load_detector()("noon.jpg"), skope.read_camera("camera.json"))
print(located.good.sum(), "of", len(located.poses), "vehicles have a pose")
""",
    "Poses": """
import numpy as np
import skope

poses = skope.estimate_poses(skope.load_detector()("noon.jpg"), skope.read_camera("camera.json")).poses
sigma_m = np.sqrt(np.diagonal(poses.covariance, axis1=1, axis2=2)[:, :2])
print(np.degrees(poses.yaw).round(), poses.size_lwh.round(1), sigma_m.round(2))
""",
    "Track": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
for track in tracks:
    print(track.number, track.class_name, track.position.shape, track.speed.max().round(1))
""",
    "Tracks": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
tracks.to_csv("tracks.csv")
print(len(tracks), tracks.times_s[-1].round(1), [vehicle.number for vehicle in tracks.at(10)])
#> 2 2.9 [1, 2]
""",
    "TrackedRoadUser": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
for vehicle in tracks.at(10):
    print(vehicle.number, vehicle.class_name, vehicle.position.round(1), round(vehicle.speed, 1))
""",
    "Count": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
row = max(skope.count(tracks, "site.toml"), key=lambda row: row.count or 0)
print(row.gate, row.class_name, row.count, row.confidence_interval.low, row.confidence_interval.high)
""",
    "TrafficReport": """
import skope

tracks = skope.load_detector().video("crossing.mp4", camera="camera.json").tracks()
report = skope.measure_traffic(tracks, skope.read_site("site.toml"))
print(len(report.crossings), "crossing,", len(report.speeds), "rows of speeds")
print(report.notes)  # values that are not available, and why
""",
    "SiteCalibration": """
import numpy as np
import skope

true = skope.Camera.looking([0, 0, 6.5], yaw=0.0, pitch_down=0.3, size=(1920, 1080))
places = np.array([[12, 4, 0], [14, -5, 0], [20, 6, 0], [25, -8, 0], [32, 3, 0], [40, -4, 0], [28, 9, 0]])
calibration = skope.calibrate_camera((true.project(places)[0], places), size=(1920, 1080))
print(calibration.camera.position.round(2), calibration.covariance.shape)
print(calibration.place_error([[960, 700]]).round(2))  # 90% radius on the road, metres
""",
    "CameraEstimate": """
import skope

video = skope.load_detector().video("traffic.mp4")
try:
    estimate = video.estimate_camera(height_m=7.0)
    print(estimate.camera.position, estimate.vehicles, estimate.sigma_pitch)
except skope.UserError as error:  # the vehicles do not determine the camera
    print(error)
""",
    "coco": """
from pathlib import Path

import skope

file = skope.coco.read(Path("data/roads/annotations/train.json"))
print(len(file.images), len(file.annotations), file.annotations[0].keypoints.shape)
#> 2 4 (33, 3)
""",
    "draw": """
import skope

image = next(iter(skope.open_dataset("data/roads")))
skope.draw.write("labels.png", skope.draw.annotations(image.pixels(), image.annotations, scale=4))
print(skope.read_image("labels.png").shape)
#> (480, 640, 3)
""",
    "__version__": """
import skope

print(skope.__version__)
#> 0.2.0
""",
}
"""Programs by name: those of `import skope`, and the classes that its functions return."""
