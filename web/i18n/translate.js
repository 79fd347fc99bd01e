// Translation functions: English texts, or a language that is loaded when it is chosen.

import { ENGLISH } from "./en.js";

/** Languages of the exam page. Drafts were not checked by a native speaker and are marked in the choice. */
export const LANGUAGES = Object.freeze({
  en: { name: "English" },
  hi: { name: "हिन्दी", draft: true },
  ta: { name: "தமிழ்", draft: true },
  te: { name: "తెలుగు", draft: true },
});

let language = "en-u-nu-latn"; // Latin digits in every language
let texts = ENGLISH;
let plurals = new Intl.PluralRules(language);

/** Use another language: texts that `table` lacks stay English. `tag` is a BCP 47 tag such as "hi". */
export function useLanguage(tag, table) {
  language = `${tag}-u-nu-latn`;
  texts = { ...ENGLISH, ...table };
  plurals = new Intl.PluralRules(language);
  document.documentElement.lang = tag;
}

/**
 * Load and use a language; "en-XA" is a pseudo-locale, 40 % longer than English, to find untranslated and clipped
 * texts.
 */
export async function loadLanguage(tag) {
  if (tag === "en-XA") useLanguage(tag, pseudoLocale());
  else useLanguage(LANGUAGES[tag] ? tag : "en", await loadTexts(tag));
}

/** Load the texts of a language on demand. */
export const loadTexts = async (tag) => (LANGUAGES[tag]?.draft ? (await import(`./${tag}.js`)).WORDS : ENGLISH);

const ACCENTS = { a: "á", e: "é", i: "í", o: "ó", u: "ú", A: "Á", E: "É", I: "Í", O: "Ó", U: "Ú", n: "ñ", c: "ç" };

function pseudoLocale() {
  const lengthen = (text) => {
    const accented = text.replace(/\{\w+\}|[a-zA-Z]/g, (part) => ACCENTS[part] ?? part);
    return `[${accented}${" one two three four five six seven".slice(0, Math.round(text.length * 0.4))}]`;
  };
  const both = (entry) => (typeof entry === "string" ? lengthen(entry) : { one: lengthen(entry.one), other: lengthen(entry.other) });
  return Object.fromEntries(Object.entries(ENGLISH).map(([key, entry]) => [key, both(entry)]));
}

/** Return the text of `key` with {names} replaced; `vars.n` selects the plural form. */
export function t(key, vars = {}) {
  const entry = texts[key];
  if (entry === undefined) throw new Error(`no words for ${key}`);
  const text = typeof entry === "string" ? entry : (entry[plurals.select(vars.n)] ?? entry.other);
  return text.replace(/\{(\w+)\}/g, (_, name) => String(vars[name]));
}

/** Return whether `key` has a text and `vars` has every value that it needs. */
export function has(key, vars = {}) {
  const entry = ENGLISH[key];
  if (entry === undefined) return false;
  const text = typeof entry === "string" ? entry : entry.other;
  return [...text.matchAll(/\{(\w+)\}/g)].every(([, name]) => vars[name] !== undefined && vars[name] !== null);
}

export function clockTime(iso) {
  const form = new Intl.DateTimeFormat(language, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
  return form.format(new Date(iso));
}

export function calendarDay(iso) {
  return new Intl.DateTimeFormat(language, { day: "numeric", month: "short", year: "numeric" }).format(new Date(iso));
}

/** Return a language's name in the current language. */
export const languageName = (tag) => new Intl.DisplayNames(language, { type: "language" }).of(tag);

const twoDigits = (value) => String(value).padStart(2, "0");

/** Return a date in ISO form, such as 2026-11-20. */
export const isoDay = (date) => `${date.getFullYear()}-${twoDigits(date.getMonth() + 1)}-${twoDigits(date.getDate())}`;
export const today = () => isoDay(new Date());

export function isToday(iso) {
  return new Date(iso).toDateString() === new Date().toDateString();
}

/** Format a number in the current language, by default with at most one decimal. */
export function number(value, digits = 1) {
  return new Intl.NumberFormat(language, { maximumFractionDigits: digits }).format(value);
}

/** Format a number with its sign and that many decimals; zero has no sign. */
export function signed(value, digits = 2) {
  /** @type {Intl.NumberFormatOptions} */
  const form = { signDisplay: "exceptZero", minimumFractionDigits: digits, maximumFractionDigits: digits };
  return new Intl.NumberFormat(language, form).format(value);
}
