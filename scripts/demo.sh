#!/usr/bin/env bash
# What skope does, in minutes: generate images, look with the shipped detector, follow vehicles in metres, fine-tune.
# What is finished is not done again.
set -euo pipefail
SKOPE=${SKOPE:-skope}
PYTHON=${PYTHON:-python}
DATA=data/demo RUN=runs/demo SITE=t06_plaza_opening
VIDEO=$RUN/footage/$SITE.mp4 TUNED=$RUN/tuned

# Run a command unless the file that it writes last is there.
once() {
    local made=$1
    shift
    [ -e "$made" ] || "$@"
}

echo "== 1/5 generate labelled images of two roads"
once "$DATA/dataset.json" "$SKOPE" gen --sites "t01_mill_corner,$SITE" --frames 6 --size 1280x720 --out "$DATA"

echo "== 2/5 road33, the detector that comes with skope, on one of them, which it has never seen"
once "$RUN/road33/report.html" "$SKOPE" eval --data "$DATA" --split extra --out "$RUN/road33"

echo "== 3/5 footage of that road: find the vehicles, follow them, in metres"
once "${VIDEO%.mp4}.json" "$SKOPE" gen video "$SITE" --fps 5 --seconds 12 --size 1280x720 --out "$RUN/footage"
once "$RUN/seen/overlay.mp4" "$SKOPE" eval predict "$VIDEO" --camera "${VIDEO%.mp4}.json" --overlay --out "$RUN/seen"
once "$RUN/tracks/birdseye.png" "$SKOPE" eval track "$RUN/seen" --out "$RUN/tracks"

echo "== 4/5 fine-tune road33 in one pass over the six images of the other road, and measure again"
if [ -e "$TUNED/resume.pt" ]; then
    once "$RUN/tuned_score/report.html" "$SKOPE" train --out "$TUNED" --resume
else
    # A frozen backbone and few regions an image make a step on two cores a matter of seconds.
    "$SKOPE" train --data "$DATA" --out "$TUNED" --init road33 --epochs 1 --val-fraction 0 \
        --set trainable_layers=0 --set keypoint_regions=8
fi
once "$RUN/tuned_score/report.html" \
    "$SKOPE" eval --data "$DATA" --checkpoint "$TUNED" --split extra --out "$RUN/tuned_score"
"$SKOPE" eval compare "$RUN/road33" "$RUN/tuned_score"

echo "== 5/5 one page of all that"
"$PYTHON" scripts/demo_page.py "$RUN" --data "$DATA"
