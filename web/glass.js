// A picture on the glass: where it lies, how its pixels are shown when they are larger or smaller than those of the screen,
// and the loupe over it.

import { clamp } from "./field.js";

// Below four screen pixels a picture's pixel may be smoothed: cut into ones and twos of the screen, it would show stripes that
// no retina has. From four on it stands as the square that it is. Smoothing it further would draw soft spots and edges between
// measured values, and a reader could no longer tell what was seen from what was filled in.
const SQUARE_FROM = 4;
const LOUPE = 2.5; // times what is seen around it
const LOUPE_SHARE = 0.4; // of the shorter side
const FINGER_CSS_PX = 40; // what a fingertip hides above its point

/** Draw `shown` so that its point (u, v), in widths from its middle, lies at `at` and it is `width` x `height` large. */
export function place(context, shown, { u, v, width, height }, at = middleOf(context)) {
  const scale = width / shown.width;
  context.imageSmoothingEnabled = scale < SQUARE_FROM;
  // Shrinking needs a mean of all pixels; enlarging takes the plain way between neighbours, which overshoots nowhere.
  context.imageSmoothingQuality = scale < 1 ? "high" : "low";
  context.drawImage(shown, at.x - width / 2 - u * width, at.y - height / 2 - v * width, width, height);
}

/** The loupe around its point; held by a finger it stands beside the finger. */
export function lens(context, shown, { u, v, width, height, loupe }) {
  const { width: wide, height: high } = context.canvas;
  const middle = middleOf(context);
  const unit = wide / context.canvas.clientWidth;
  const radius = (Math.min(wide, high) * LOUPE_SHARE) / 2;
  const point = { x: middle.x + (loupe.u - u) * width, y: middle.y + (loupe.v - v) * width };
  const at = loupe.held ? beside(point, radius + FINGER_CSS_PX * unit, radius, middle) : point;
  const centre = { x: clamp(at.x, radius, wide - radius), y: clamp(at.y, radius, high - radius) };
  context.save();
  context.beginPath();
  context.arc(centre.x, centre.y, radius, 0, 2 * Math.PI);
  context.save();
  context.clip();
  context.fillStyle = "#000";
  context.fill();
  place(context, shown, { u: loupe.u, v: loupe.v, width: width * LOUPE, height: height * LOUPE }, centre);
  context.restore();
  for (const [colour, line] of [["#000", 5], ["#fff", 2]]) {
    context.strokeStyle = colour; // white on black: seen on every retina
    context.lineWidth = line * unit;
    context.stroke();
  }
  context.restore();
}

// Above the finger; where there is no room above, on the side with more room.
function beside({ x, y }, away, radius, middle) {
  if (y - away >= radius) return { x, y: y - away };
  return { x: x > middle.x ? x - away : x + away, y };
}

const middleOf = ({ canvas }) => ({ x: canvas.width / 2, y: canvas.height / 2 });
