"""Paper, reference network and deltas: what each does where they disagree.

``python -m deltas_nets.reference.differences`` prints the page `docs/differences.md`.
"""

from typing import NamedTuple


class Difference(NamedTuple):
    """One point on which the three do not agree.

    Attributes:
        number: of the row.
        topic: what it is about.
        paper: what the paper says.
        reference: what the authors' network or its test program does.
        deltas: what deltas does unless told to run the reference network.
    """

    number: int
    topic: str
    paper: str
    reference: str
    deltas: str


DIFFERENCES = (
    Difference(
        1,
        "Confidence layer",
        "no layer that learns a confidence",
        "stores a 3x3 convolution with batch norm for it and never runs it",
        "skips these weights on loading; the confidence of a point comes from its posterior",
    ),
    Difference(
        2,
        "Range of the input",
        "not stated",
        "maps images to [-1, 1], then normalises by ImageNet's mean and deviation on top",
        "images are RGB in [0, 1], normalised once, inside the network; for published weights "
        "`reference.evaluation_input` gives the range they were evaluated with",
    ),
    Difference(
        3,
        "Points that are not detected",
        "at most half of the points are detected, the others random",
        "draws random pixels with repetition, also on detected points and on the border",
        "the others are spread evenly by a fixed low-discrepancy sequence, the same every time",
    ),
    Difference(
        4,
        "Intrinsics",
        "not stated",
        "one camera matrix for all views",
        "a camera matrix for each view",
    ),
    Difference(
        5,
        "Points behind a source camera",
        "not stated",
        "projects them as if they were in front",
        "cuts the depth interval to what is in front of the source",
    ),
    Difference(
        6,
        "Search range",
        "the epipolar line is clamped to the feasible depths",
        "drops the segment if either of its ends leaves the image",
        "clips the segment to the image; it is empty only if nothing remains",
    ),
    Difference(
        7,
        "Reading descriptors",
        "bilinear sampling",
        "coordinates of corner-aligned maps in a lookup that is not: up to 4 pixels off, zero "
        "outside",
        "the map is the image plane sampled coarser: pixel p is at (p + 0.5) / stride - 0.5, "
        "and the border continues outside",
    ),
    Difference(
        8,
        "Weight of a view",
        "the maximum of the correlation map",
        "the sigmoid of the maximum after batch norm and ReLU, times 1.001 in range and 0.001 "
        "out of it, where the match is pixel (0, 0)",
        "a view that does not see the point takes no part at all; a point that too few views "
        "see is marked invalid",
    ),
    Difference(
        9,
        "Offsets across the line",
        "the match is the map's centre of mass in the image",
        "halves the part across the line",
        "centre of mass of the true pixels, along and across",
    ),
    Difference(
        10,
        "Solving the triangulation",
        "singular vector of the smallest singular value",
        "float32 on rows in pixels; one infinite coordinate clamps all points of the batch, NaN "
        "stays",
        "solved in the frame of the camera rig in float64 where there is one; every point has "
        "a status of its own and none affects another",
    ),
    Difference(
        11,
        "Sparse depth image",
        "the points' depth at their pixels",
        "truncates pixels; invalid points write 0, also over valid ones; who wins where two meet "
        "is left open",
        "rounds pixels; only valid points write; points that meet are averaged by confidence",
    ),
    Difference(
        12,
        "Enlarging maps in the decoder",
        'an "upsampling" block',
        "zeros between the pixels, or nearest neighbour where the number of rows is no multiple; "
        "the columns are not asked",
        "the paper's decoder does the same but asks rows and columns; any height and width",
    ),
    Difference(
        13,
        "Range of the output",
        "depths from 0.5 to 10 m",
        "unbounded, may be negative",
        "predicts log depth, also with the paper's decoder: every depth is positive",
    ),
    Difference(
        14,
        "Frames of a scene",
        "20 frames apart",
        "takes the position of a frame for its file name, caches the list of samples under a name "
        "without the folder and cuts the last character off each scene's name",
        "frames go by the names of their files; nothing is cached",
    ),
    Difference(
        15,
        "Resizing true depth",
        "not stated",
        "linear: averages across edges, and with 0 at holes",
        "nearest neighbour",
    ),
    Difference(
        16,
        "Depth camera",
        "not stated",
        "takes depth as registered with the colour image",
        "uses the intrinsics of the depth camera where the capture has them, and takes it to "
        "stand where the colour camera stands",
    ),
    Difference(
        17,
        "Negative predictions in the inlier ratios",
        "share of ratios below 1.25, squared and cubed",
        "a negative prediction has a negative ratio and counts as an inlier",
        "zero or less is no prediction: it lowers the coverage, which is reported",
    ),
    Difference(
        18,
        "RMSE",
        "RMSE and RMSE of the logarithm are reported",
        "computes neither",
        "computes both",
    ),
    Difference(
        19,
        "Images without true depth",
        "mean over images",
        "left out of the sum but counted in the divisor",
        "left out of both",
    ),
    Difference(
        20,
        "Mean over a data set",
        "mean over images",
        "mean of the batches' means, whatever the size of the last one",
        "mean over all images",
    ),
    Difference(
        21,
        "Supervised scales",
        "four scales from full resolution to 1/16",
        "has four outputs at 1, 1/2, 1/4 and 1/8",
        "the paper's decoder has the reference's four; `deltas-small` has 1, 1/4, 1/8 and 1/16",
    ),
    Difference(
        22,
        "Spatial pyramid",
        "spatial pyramid pooling, ASPP",
        "densely connected dilated convolutions at 1/8, without pooling",
        "the paper's decoder does as the reference; `deltas-small` has none",
    ),
    Difference(
        23,
        "Epipolar line",
        "from the fundamental matrix, infinite, then clamped by depth",
        "the ends come from two projections, the fundamental matrix only gives the direction",
        "one construction: the segment between the two projected ends",
    ),
    Difference(
        24,
        "Images that are searched for points",
        "the anchor",
        "detects and picks in all images, then ignores those of the sources",
        "the anchor",
    ),
    Difference(
        25,
        "Matching template",
        'the descriptor is "convolved" with the field',
        "a dot product: the template is 1x1",
        "a dot product",
    ),
    Difference(
        26,
        "Training",
        "five losses",
        "not published",
        "written from the paper; the terms and both weights are in `deltas_nets.config.losses`",
    ),
    Difference(
        27,
        "Cost of matching two images",
        "below 0.002 GMACs for matching and triangulation",
        "0.0197 GMACs for the correlation of 512 points alone",
        "costs are counted with the correlation",
    ),
)
"""All of them, in the order of the page."""

_HEAD = """\
# Differences from the original

Where the paper and the network that its authors published disagree, or leave something open, this
is what each does, and what deltas does. The reference network as it is, with all of this, is
`deltas_nets.reference`, which `deltas depth --weights FILE` runs where FILE is the
[published checkpoint](published_checkpoint.md); only there do its rules apply.

This page is generated: change `deltas_nets/reference/differences.py`, then run
`python -m deltas_nets.reference.differences > docs/differences.md`.

| | | The paper | The reference network | deltas |
|--|--|--|--|--|
"""


def page() -> str:
    """The page as Markdown."""
    rows = (
        f"| {row.number} | {row.topic} | {row.paper} | {row.reference} | {row.deltas} |\n"
        for row in DIFFERENCES
    )
    return _HEAD + "".join(rows)


if __name__ == "__main__":
    print(page(), end="")
