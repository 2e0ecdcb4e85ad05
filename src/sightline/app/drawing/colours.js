// All colours of the page: names for painting, and CSS variables for style sheets.
//
// Hues of Okabe and Ito, Color Universal Design (2008), without blue and black, too dark on a dark page; green and
// vermillion are lighter than theirs, to be legible as text. tests/app/test_colours.py computes the contrasts.

export const COLOURS = {
// Hues with a meaning; a sign, a shape or dashes carry it too.
  sky: "#56b4e9", // the accent
  green: "#2fc79a", // good
  orange: "#e69f00", // warning
  vermillion: "#ff8a5c", // bad
  yellow: "#f0e442",
  purple: "#cc79a7",
  bone: "#eadbb8",
  steel: "#8fa3b8",
// Text and lines.
  text: "#eef2f6",
  quiet: "#a9b6c3",
  edge: "#7d8b99", // of a control
  line: "#36424f", // separators, without meaning
// Backgrounds of text.
  stage: "#07090b",
  ground: "#0e1217",
  panel: "#171d24",
  raised: "#222b35",
  chosen: "#1b3346",
  go: "#0c2f26",
  "no-go": "#3a1c10",
  primary: "#0b6ea8",
  danger: "#b3261e",
  alarm: "#5a2a00",
};

for (const [name, colour] of Object.entries(COLOURS)) document.documentElement.style.setProperty(`--${name}`, colour);
