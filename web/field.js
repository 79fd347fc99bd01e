// Where the picture lies on the glass: which part of it is shown, and how many pixels the canvas has. Shared by the live
// picture and the taken one, so that both have one place and one size.

const MARGIN = 1.06; // black rim around the illuminated disc

/**
 * The part of a picture (in its own pixels, around its centre) that is shown at zoom 1: the square around the
 * illuminated disc, or everything when the disc is not known or the picture is not a scaled whole frame.
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

/** Make a canvas as many pixels as it covers on the glass; false when nothing is to be seen. */
export function fitCanvas(canvas) {
  const ratio = Math.min(devicePixelRatio || 1, 2); // beyond 2 the eye gains nothing and the chip pays
  const width = Math.round(canvas.clientWidth * ratio);
  const height = Math.round(canvas.clientHeight * ratio);
  if (canvas.width !== width || canvas.height !== height) Object.assign(canvas, { width, height });
  return width > 0 && height > 0;
}

export const clamp = (value, low, high) => Math.min(Math.max(value, low), high);
