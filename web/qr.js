// A text as a code that a telephone reads. The encoder is loaded with the first of them.

/** @returns {Promise<{size: number, path: string}>} the dark squares as one SVG path, one unit a square. */
export async function codeOf(text) {
  const { correction, generate } = await import("./vendor/lean-qr-nano.mjs");
  const drawing = generate(text, { minCorrectionLevel: correction.M });
  const { size } = drawing;
  const rows = Array.from({ length: size }, (_, y) =>
    Array.from({ length: size }, (_, x) => (drawing.get(x, y) ? `M${x} ${y}h1v1h-1z` : "")).join(""),
  );
  return { size, path: rows.join("") };
}
