// Every colour of the page, in one place: named here for what is painted, and as variables of the page for its sheets.
//
// Hues of Okabe and Ito, Color Universal Design (2008), without blue and black, too dark on a dark page; green and
// vermillion are lighter than theirs, to be read as words. tests/app/test_colours.py computes the contrasts.

export const COLOURS = {
  // Hues that mean something; what could be confused has a sign, a shape or dashes too.
  sky: "#56b4e9", // the accent
  green: "#2fc79a", // good
  orange: "#e69f00", // look out
  vermillion: "#ff8a5c", // bad
  yellow: "#f0e442",
  purple: "#cc79a7",
  bone: "#eadbb8",
  steel: "#8fa3b8",
  // Words and lines.
  text: "#eef2f6",
  quiet: "#a9b6c3",
  edge: "#7d8b99", // of a control
  line: "#36424f", // between things; it says nothing
  // Grounds of words.
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
