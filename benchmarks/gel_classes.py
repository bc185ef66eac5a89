"""Draw docs/pictures/gel_classes.jpg: the classes and factors of the images of `gelflow render`."""

import argparse
import sys
from pathlib import Path

import cv2
import script

from gelflow.perception.benchmark.gel_classes import contact_sheet


def main() -> int:
    parser = argparse.ArgumentParser(description="Draw the classes of synthetic gel images.")
    parser.add_argument("--out", type=Path, default=script.PICTURES / "gel_classes.jpg", help="file (%(default)s)")
    args = parser.parse_args()
    cv2.imwrite(str(args.out), contact_sheet(), [cv2.IMWRITE_JPEG_QUALITY, 80])
    print(args.out)
    return 0


if __name__ == "__main__":
    sys.exit(script.run(main))
