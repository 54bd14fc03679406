#!/usr/bin/env bash
# The whole chain from random weights: generate a dataset, train until a few of its frames are known by heart, measure.
set -euo pipefail
SKOPE=${SKOPE:-skope}
DATA=data/skope RUN=runs/chain FRAMES=3

echo "== 1/4 generate"
"$SKOPE" gen --out "$DATA"
"$SKOPE" gen check "$DATA"

echo "== 2/4 train from random weights on $FRAMES frames, to see the whole chain learn"
if [ -e "$RUN/resume.pt" ]; then
    "$SKOPE" train --out "$RUN" --resume
else
    "$SKOPE" train --data "$DATA" --out "$RUN" --recipe scratch --max-images "$FRAMES" --epochs 60 --val-fraction 0
fi

echo "== 3/4 score the $FRAMES frames that it was trained on: this says that the chain works, not that it generalises"
"$SKOPE" eval --data "$DATA" --checkpoint "$RUN" --split train --max-images "$FRAMES" --out "$RUN/eval_seen"

echo "== 4/4 score frames of sites that it never saw: expect little from $FRAMES training frames and no pretraining"
"$SKOPE" eval --data "$DATA" --checkpoint "$RUN" --out "$RUN/eval"

cat << END

Done. Look at
  $DATA/images                 generated frames; $DATA/README.md says what they are
  $RUN/eval_seen/report.html   in a browser: figures, curves and pictures of the frames it knows
  $RUN/eval/report.html        the same at sites it never saw
  $RUN/eval_seen/metrics.json  the figures of the tables above
To train on all frames: $SKOPE train --epochs 10, then $SKOPE eval --split hard
END
