// Viewport geometry that live preview and viewer share: the visible part of a picture, and the size of the canvas in
// pixels.

const MARGIN = 1.06; // black margin around the illuminated disc

/**
 * Return the part of a picture (in its pixels, around its centre) that is visible at zoom 1: the square around the
 * illuminated disc, or the whole picture if the disc is unknown or the aspect ratio differs.
 * @param {{shape?: number[], field_px?: number|null}|null} head
 */
export function homeBox(head, width, height) {
  if (head?.field_px && head.shape) {
    const [rows, cols] = head.shape;
    const scale = width / cols;
    if (Math.abs(height / (rows * scale) - 1) < 0.02) {
      const side = head.field_px * scale * MARGIN;
      return { width: Math.min(side, width), height: Math.min(side, height), disc: head.field_px * scale };
    }
  }
  return { width, height, disc: Math.min(width, height) };
}

/**
 * Return the 2-D context of a canvas.
 * @param {HTMLCanvasElement} canvas
 * @param {CanvasRenderingContext2DSettings} [options]
 */
export function context2d(canvas, options) {
  const context = canvas.getContext("2d", options);
  if (!context) throw new Error("this canvas has no 2-D context");
  return context;
}

/** Match the canvas to its size on the screen in device pixels; false if it is not visible. */
export function fitCanvas(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2); // a higher ratio costs time without visible gain
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return width > 0 && height > 0;
}

export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
