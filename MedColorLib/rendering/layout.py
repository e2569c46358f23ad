"""The contact sheet's paper: panels, headings and labels. Knows pixels and text, no volumes."""

from __future__ import annotations

import numpy as np

SHEET_RGB = (22, 23, 26)
PANEL_RGB = (0, 0, 0)
LABEL_RGB = (205, 208, 214)
FAINT_RGB = (128, 132, 140)


class Sheet:
    """A dark sheet of `columns` x `rows` cells; each cell holds one panel per title, side by side.

    Attributes:
        picture: (H, W, 3) uint8 RGB.
        panel_size: (width, height) in pixels of each panel.
    """

    def __init__(self, size: tuple[int, int], grid: tuple[int, int], titles: tuple[str, ...], footnote: str) -> None:
        """Args: size (width, height) in pixels; grid (columns, rows); titles over the panels of each column."""
        width, height = (int(n) for n in size)
        columns, rows = grid
        self.picture = np.full((height, width, 3), SHEET_RGB, dtype=np.uint8)
        # Height of a line of text; all distances are in proportion to it.
        self._unit = max(8, round(min(height / 75, width / 100)))
        self._gap, self._seam = self._unit, max(2, self._unit // 6)
        self._columns = columns
        self._head = 3 * self._unit if any(titles) else self._gap
        foot = 2 * self._unit + self._gap // 2
        cell_width = (width - self._gap * (columns + 1)) // columns
        panel_width = (cell_width - self._seam * (len(titles) - 1)) // len(titles)
        panel_height = (height - self._head - foot - self._gap * (rows - 1)) // rows
        self.panel_size = (panel_width, panel_height)
        self._cell_step = (cell_width + self._gap, panel_height + self._gap)
        for column in range(columns):
            for n, title in enumerate(titles):
                x, _ = self._corner(column, n)
                self._write(title, (x + panel_width // 2, self._head - self._unit), LABEL_RGB, align=0.5)
        self._write(footnote, (width // 2, height - self._unit), FAINT_RGB, align=0.5)
        for cell in range(columns * rows):
            for n in range(len(titles)):
                x, y = self._corner(cell, n)
                self.picture[y : y + panel_height, x : x + panel_width] = PANEL_RGB

    def _corner(self, cell: int, panel: int) -> tuple[int, int]:
        row, column = divmod(cell, self._columns)
        x = self._gap + column * self._cell_step[0] + panel * (self.panel_size[0] + self._seam)
        return x, self._head + row * self._cell_step[1]

    def place(self, cell: int, panel: int, picture: np.ndarray, label: str, edges: tuple[str, str] = ("", "")) -> None:
        """Fit `picture` into a panel with its aspect kept; label on top, letters at the left and right edge.

        A picture of just the panel's size fills it, any other leaves room for the label.
        """
        import cv2

        x, y = self._corner(cell, panel)
        width, height = self.panel_size
        if picture.shape[:2] != (height, width):
            scale = min((width - 5 * self._unit) / picture.shape[1], (height - 4 * self._unit) / picture.shape[0])
            fitted = tuple(max(1, round(scale * n)) for n in picture.shape[1::-1])
            picture = cv2.resize(picture, fitted, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC)
        top, left = y + (height - picture.shape[0]) // 2, x + (width - picture.shape[1]) // 2
        self.picture[top : top + picture.shape[0], left : left + picture.shape[1]] = picture
        inset = self._unit // 2
        self._write(label, (x + inset, y + inset + self._unit), LABEL_RGB)
        self._write(edges[0], (x + inset, y + height // 2), FAINT_RGB)
        self._write(edges[1], (x + width - inset, y + height // 2), FAINT_RGB, align=1.0)

    def _write(self, text: str, at: tuple[int, int], rgb: tuple[int, int, int], align: float = 0.0) -> None:
        """Write with the baseline at y; x is the text's left end (align 0), middle (0.5) or right end (1)."""
        import cv2

        if not text:
            return
        font, scale = cv2.FONT_HERSHEY_SIMPLEX, self._unit / 24.0
        (width, _), _ = cv2.getTextSize(text, font, scale, 1)
        cv2.putText(self.picture, text, (round(at[0] - align * width), at[1]), font, scale, rgb, 1, cv2.LINE_AA)
