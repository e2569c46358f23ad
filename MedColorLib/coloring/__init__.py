"""Colour: matched colours and the scan's own luminance become one slice in sRGB, with the evidence of its neighbours."""
