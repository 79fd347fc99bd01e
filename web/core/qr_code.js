// QR code of a text; the encoder is loaded with the first code.

/** @returns {Promise<{size: number, path: string}>} the dark modules as one SVG path, one unit per module. */
export async function qrCode(text) {
  const { correction, generate } = await import("../vendor/lean-qr-nano.mjs");
  const bitmap = generate(text, { minCorrectionLevel: correction.M });
  const { size } = bitmap;
  const rows = Array.from({ length: size }, (_, y) =>
    Array.from({ length: size }, (_, x) => (bitmap.get(x, y) ? `M${x} ${y}h1v1h-1z` : "")).join(""),
  );
  return { size, path: rows.join("") };
}
