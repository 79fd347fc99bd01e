// How the page speaks: the words of english.js, or those of a language that is loaded when somebody chooses it.

import { ENGLISH } from "./english.js";

/** Languages of the screener's page. Drafts were written without a native speaker, and say so where they are chosen. */
export const LANGUAGES = Object.freeze({
  en: { name: "English" },
  hi: { name: "हिन्दी", draft: true },
  ta: { name: "தமிழ்", draft: true },
  te: { name: "తెలుగు", draft: true },
});

let language = "en-u-nu-latn"; // Latin digits in every language: some locales would otherwise switch to their own
let words = ENGLISH;
let plurals = new Intl.PluralRules(language);

/** Use another language: `table` may be incomplete, English fills the gaps. `tag` is a BCP 47 tag such as "hi". */
export function speak(tag, table) {
  language = `${tag}-u-nu-latn`;
  words = { ...ENGLISH, ...table };
  plurals = new Intl.PluralRules(language);
  document.documentElement.lang = tag;
}

/** Load and use a language; "en-XA" is English stretched by 40 %, in which no text of the page can hide. */
export async function learn(tag) {
  if (tag === "en-XA") speak(tag, stretched());
  else speak(LANGUAGES[tag] ? tag : "en", await tableOf(tag));
}

/** The words of a language, loaded when they are first asked for. */
export const tableOf = async (tag) => (LANGUAGES[tag]?.draft ? (await import(`./words_${tag}.js`)).WORDS : ENGLISH);

const ACCENTS = { a: "á", e: "é", i: "í", o: "ó", u: "ú", A: "Á", E: "É", I: "Í", O: "Ó", U: "Ú", n: "ñ", c: "ç" };

function stretched() {
  const long = (text) => {
    const accented = text.replace(/\{\w+\}|[a-zA-Z]/g, (part) => ACCENTS[part] ?? part);
    return `[${accented}${" one two three four five six seven".slice(0, Math.round(text.length * 0.4))}]`;
  };
  const both = (entry) => (typeof entry === "string" ? long(entry) : { one: long(entry.one), other: long(entry.other) });
  return Object.fromEntries(Object.entries(ENGLISH).map(([key, entry]) => [key, both(entry)]));
}

/** The text for `key`, with {names} filled in; a key with a plural is chosen by `vars.n`. */
export function t(key, vars = {}) {
  const entry = words[key];
  if (entry === undefined) throw new Error(`no words for ${key}`);
  const text = typeof entry === "string" ? entry : (entry[plurals.select(vars.n)] ?? entry.other);
  return text.replace(/\{(\w+)\}/g, (_, name) => String(vars[name]));
}

/** Whether there are words for `key` and everything that they mention is known. */
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

/** What a language is called in the reader's own. */
export const languageName = (tag) => new Intl.DisplayNames(language, { type: "language" }).of(tag);

const two = (value) => String(value).padStart(2, "0");

/** A day as the instrument writes it, such as 2026-11-20. */
export const dayName = (date) => `${date.getFullYear()}-${two(date.getMonth() + 1)}-${two(date.getDate())}`;
export const today = () => dayName(new Date());

export function isToday(iso) {
  return new Date(iso).toDateString() === new Date().toDateString();
}

/** One decimal at most, in the reader's language. */
export function number(value, digits = 1) {
  return new Intl.NumberFormat(language, { maximumFractionDigits: digits }).format(value);
}
