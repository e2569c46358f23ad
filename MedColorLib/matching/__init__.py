"""Matching: which place of the photograph looks like each place of the scan, and how far that can be trusted.

Where the preset `full` departs from Devkota and Pattanaik 2020 and Liao et al. 2017, and what it changes. Mean CIEDE2000 of
a*, b* on four pairs with known colours (thorax section mirrored and warped; luminance as it is / g^0.6 / two greys to one,
sin(pi g) / inverted), VGG-19. By the votes of the matches alone: `full` 2.0 / 2.0 / 2.4 / 2.0, a public port of deep image
analogy 4.0 / - / 5.3 / -, on pairs of its own kind. After the paper's transfer (`--luminance paper`): 2.8 / 2.9 / 3.1 / 3.7,
the port 4.8 / - / 5.4 / -. Where nothing else is said, figures are those after the paper's transfer.

| step | the paper | `full` | what the departure changes |
| --- | --- | --- | --- |
| network | gray VGG-19 | VGG-19, luminance in all planes (`--features gray-vgg19` has the paper's) | not measured |
| place of the photograph | as it lies | turned and mirrored where that fits better | 3.7 / 3.7 / 4.1 / 4.4 without |
| contrast, for matching | as it is | histogram match, or a curve learned from a coarse match | as it is 2.9 / 3.1 / 3.2 / 4.9; \
histogram match alone 2.8 / 2.9 / 3.1 / 6.4 |
| where a match may lie | anywhere | in the photograph's tissue | else gelatin's blue leaks into the head (not measured) |
| search at layers 5 to 3 | PatchMatch, 10 iterations | every patch with every patch | patch distance above the least: 0.0001 \
instead of 0.004 (layer 4) and 0.011 (layer 3) |
| search at layers 2 and 1 | PatchMatch, 10 iterations | every patch of a window of 24 x 24, twice | 0.004 above the least \
instead of 0.011, held against it at layer 3 |
| features one layer down | L-BFGS | the photograph's own, warped (`--reconstruction lbfgs` has the paper's) | L-BFGS, matches \
alone: 8 iterations 2.0 / - / 2.4 / 2.0, 16 (default) 2.2 / - / 2.6 / 2.4, 32 - / - / 3.1 / 2.5, though its loss falls |
| patches, radii, blend weights, vote | 3, 3, 3, 5, 5; 6, 6, 4, 4; alpha 0.8, 0.7, 0.6, 0.1; 5 x 5 | the same | none |
| gamma | 1/2, then 2 | the same beside the paper's luminance, else off | with it beside the scan's own 2.9 / 4.0 / 6.4 / 6.0 |
| luminance | the equation's | natural, `--luminance paper` has the paper's | 3.3 / 3.3 / 3.4 / 3.3 (gamma off), after the gamut |
| where the reference changes | each slice by itself | matched colours averaged along the stack, within 16 mm | jump there \
1.0 times that elsewhere instead of 4.1 (CIEDE2000 of slices at equal grey, phantom) |
| smoother, its guide | FGS 32, 200, 8 bits | the same | none (OpenCV's own lambda, not shared out, smooths 2.6 times as much) |
| colours outside sRGB | cut off | drawn in at their lightness and hue | not measured |

Parts that follow the paper are held against independent versions of themselves in `Testing/Library/matching/test_paper_parts.py`.
Two of its choices cost more than they bring here, and are kept in `full` because they are the paper's: FGS at lambda 32 and
sigma 200 blurs matches that are right (sigma 5: 1.8 / 1.9 / 2.3 / 2.2), and weak positions of a layer take the warped features
alone (with all of them blended by alpha the votes are at 1.4 / - / 2.3 / 1.4).
"""
