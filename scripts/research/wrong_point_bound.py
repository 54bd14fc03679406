"""How often the wrong one of six points can be told at all, by one who knows how wrong points come about.

The sets are those of `site_calibration.py`. For each point it is worked out how likely all are if that one is wrong by
2 m along x and y (Laplace's approximation, at the camera that the search finds from the true one). "Forced": the wrong
one is the likeliest of the six, where exactly one is known to be wrong. "Found": also likelier than that none is, with
one wrong point in fifty.
Run: python scripts/research/wrong_point_bound.py --draws 40
"""

import argparse
import math
from dataclasses import replace

import numpy as np
from site_calibration import CAMERAS, SIZE, points, true_camera

from skope.camera.evidence import Evidence
from skope.camera.evidence_terms import point_term, terms_of
from skope.camera.uncertain_camera import CAMERA_PARAMETERS, values_of
from skope.camera.weighted_fit import SEARCH_SCALES, fit_terms

ASIDE_M = 2.0
ONE_IN = 50
COUNT = 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--draws", type=int, default=40, help="sets a camera")
    options = parser.parse_args()
    forced = found = 0
    for k, row in enumerate(CAMERAS):
        rng = np.random.default_rng(100 + k)
        for _ in range(options.draws):
            camera = true_camera(*row, rng)
            evidence = Evidence(SIZE, points=points(camera, COUNT, rng, wrong=True))
            terms, begin = terms_of(evidence), values_of(camera)
            none = fit_terms(terms, begin, CAMERA_PARAMETERS, SIZE).log_evidence(SEARCH_SCALES)
            each = []
            for i, point in enumerate(evidence.points):
                moved = [*terms[:i], point_term(replace(point, sigma_m=ASIDE_M)), *terms[i + 1 :]]
                each.append(fit_terms(moved, begin, CAMERA_PARAMETERS, SIZE).log_evidence(SEARCH_SCALES))
            first = each[0] == max(each)
            forced += first
            found += first and each[0] - math.log(ONE_IN - 1) > none
    total = len(CAMERAS) * options.draws
    print(f"of {total} sets: forced {forced / total:.1%}, found {found / total:.1%}")


if __name__ == "__main__":
    main()
