// QR code of a text, of which the last one is kept.

import { correction, generate } from "../vendor/lean-qr-nano.mjs";

let last = { text: "", size: 0, path: "" };

/** Return the number of modules of a side, and the dark modules as one SVG path, one unit per module. */
export function qrCode(text) {
  if (last.text !== text) last = { text, ...drawn(text) };
  return last;
}

function drawn(text) {
  const bitmap = generate(text, { minCorrectionLevel: correction.M });
  const { size } = bitmap;
  const rows = Array.from({ length: size }, (_, y) =>
    Array.from({ length: size }, (_, x) => (bitmap.get(x, y) ? `M${x} ${y}h1v1h-1z` : "")).join(""),
  );
  return { size, path: rows.join("") };
}
