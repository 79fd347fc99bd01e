// Patient numbers: their form on the screen, and their entry on the number pad.

import { get } from "./state.js";

/**
 * Return a patient's number; the check digit of an automatic number is separated by a hyphen, so that consecutive
 * numbers are easy to tell apart.
 */
export function displayNumber(number) {
  const prefix = get().programme?.numbers?.prefix;
  const automatic = prefix && number.startsWith(prefix) && /^\d{5,}$/.test(number.slice(prefix.length));
  return automatic ? `${number.slice(0, -1)}-${number.slice(-1)}` : number;
}

/** Return whether a visit has exactly this number, in either form. */
export const isNumber = ({ number }, typed) => [number, displayNumber(number)].includes(typed);

/** Return the typed text after a key of the number pad, at most `most` characters long. */
export const applyKey = (before, key, most) => (key === "erase" ? before.slice(0, -1) : (before + key).slice(0, most));
