#!/usr/bin/env bash
# Compare Keypoint R-CNN with YOLO-pose nano and small: random weights, the same images, the same minutes on one GPU.
#
#   DATA=data/bench OUT=runs/bench SEED=1 GPU=0 MINUTES=4 YOLO=yolo/bin/python bash scripts/bench/compare.sh
#
# YOLO is a Python with the package `ultralytics` (AGPL-3.0) and nothing of skope. PHOTOGRAPHS are folders of labelled
# photographs, as scripts/score_photographs.py reads them. Steps that are finished are not repeated. Each detector gets
# a folder OUT/NAME_SEED with its figures in NAME_SEED/TEST/metrics.json.
set -euo pipefail
cd "$(dirname "$0")/../.."
PYTHON=${PYTHON:-.venv/bin/python} YOLO=${YOLO:?a Python with the package ultralytics}
DATA=${DATA:-data/bench} OUT=${OUT:-runs/bench} SEED=${SEED:-1} GPU=${GPU:-0} MINUTES=${MINUTES:-4}
LOADERS=${LOADERS:-8} PHOTOGRAPHS=${PHOTOGRAPHS:-}
TRAINING=(leg_bench_1) TESTS=(world_7 nights_7) LONGEST=1152

# The places of stage "bench" and two of the tests in scripts/legs.toml.
"$PYTHON" - "$DATA" << 'END'
import subprocess, sys
from pathlib import Path
sys.path.insert(0, "scripts")
from train_leg import placed, read_stages
stages, tests = read_stages()
wanted = {**stages["bench"].places, **{name: tests[name]["places"] for name in ("world_7", "nights_7")}}
for name, options in wanted.items():
    folder = Path(sys.argv[1]) / name
    if not (folder / "dataset.json").is_file():
        words = [*placed(options, miniature=False).split(), "--no-depth", "--out", str(folder)]
        subprocess.run([sys.executable, "-m", "skope", "gen", *words], check=True)
END

if [ ! -e "$OUT/yolo/data.yaml" ]; then
    for place in "${TRAINING[@]}"; do
        [ -e "$OUT/yolo/$place" ] || "$PYTHON" -m skope gen convert "$DATA/$place" "$OUT/yolo/$place" --to yolo
    done
    # Keypoint R-CNN trains on all of these images, so YOLO does too.
    parts=$(printf '%s/images/train, ' "${TRAINING[@]}"; printf '%s/images/val, ' "${TRAINING[@]}")
    sed -e "s#^train: .*#train: [${parts%, }]#" -e "s#^val: .*#val: ${TRAINING[0]}/images/val#" -e '/^test: /d' \
        "$OUT/yolo/${TRAINING[0]}/data.yaml" > "$OUT/yolo/data.yaml"
fi

run=$OUT/keypoint_rcnn_$SEED
if [ ! -e "$run/leg.json" ]; then
    # The stage keeps 2.5 minutes for measuring; starting takes about half a minute.
    "$PYTHON" scripts/train_leg.py run bench --data "$DATA" --workers 0 --loaders "$LOADERS" --gpus "$GPU" \
        --seed "$SEED" --minutes "$(awk "BEGIN { print $MINUTES + 3 }")" --out "$run"
fi
for folder in $PHOTOGRAPHS; do
    "$PYTHON" scripts/score_photographs.py "$folder" --checkpoint "$(ls "$run"/round_*.safetensors | tail -1)" \
        --device "cuda:$GPU" --out "$run/$(basename "$folder")"
done

for network in yolo11n-pose yolo11s-pose; do
    run=$OUT/${network}_$SEED
    if [ ! -e "$run/weights/last.pt" ]; then
        "$YOLO" scripts/bench/yolo_pose.py train "$network.yaml" --data "$OUT/yolo/data.yaml" --minutes "$MINUTES" \
            --seed "$SEED" --size $LONGEST --device "$GPU" --workers "$LOADERS" --cache ram --out "$run"
    fi
    for test in "${TESTS[@]}"; do
        "$YOLO" scripts/bench/yolo_pose.py predict "$run" --annotations "$DATA/$test/annotations/extra.json" \
            --size $LONGEST --device "$GPU" --out "$run/$test.json"
        "$PYTHON" -m skope eval -q --data "$DATA/$test" --split extra --predictions "$run/$test.json" --out "$run/$test"
    done
    for folder in $PHOTOGRAPHS; do
        "$YOLO" scripts/bench/yolo_pose.py predict "$run" --annotations "$folder"/*.json --images "$folder" \
            --size $LONGEST --device "$GPU" --out "$run/$(basename "$folder").json"
        "$PYTHON" scripts/score_photographs.py "$folder" --predictions "$run/$(basename "$folder").json" \
            --out "$run/$(basename "$folder")"
    done
done
