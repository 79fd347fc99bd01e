// Translation functions: texts of the chosen language from JSON catalogues, English where one is missing.

/** Languages of the exam page. Drafts were not checked by a native speaker and are marked in the choice. */
export const LANGUAGES = Object.freeze({
  en: { name: "English" },
  hi: { name: "हिन्दी", draft: true },
  ta: { name: "தமிழ்", draft: true },
  te: { name: "తెలుగు", draft: true },
});

let language = "en-u-nu-latn"; // Latin digits in every language
let plurals = new Intl.PluralRules(language);

// Texts by key in i18next's JSON format: flat keys, {{name}} for a value, KEY_one and KEY_other for a plural.
/** @typedef {Readonly<Record<string, string>>} Texts */
/** @type {Texts} */
let english = {};
/** @type {Texts} */
let texts = english;

const RETRY_MS = 1000;

/**
 * Fetch a catalogue, empty where the server has none; try again as long as there is no connection. The page preloads
 * the English one, and the others are beside it.
 * @param {string} name
 * @returns {Promise<Texts>}
 */
async function fetchTexts(name) {
  const { href } = /** @type {HTMLLinkElement} */ (document.querySelector("#texts"));
  try {
    const response = await fetch(new URL(`${name}.json`, href));
    return response.ok ? await response.json() : {};
  } catch (problem) {
    if (!(problem instanceof TypeError)) throw problem;
    await new Promise((resolve) => setTimeout(resolve, RETRY_MS));
    return fetchTexts(name);
  }
}

/**
 * Load and use a language, English where it lacks a text; "en-XA" is a pseudo-locale, 40 % longer than English, to
 * find untranslated and clipped texts. `more` names a catalogue of further English texts.
 * @param {string} tag
 * @param {string} [more]
 */
export async function loadLanguage(tag, more) {
  const used = tag in LANGUAGES || tag === "en-XA" ? tag : "en";
  const [master, draft, further] = await Promise.all([loadTexts("en"), loadTexts(used), more ? fetchTexts(more) : {}]);
  english = { ...master, ...further };
  texts = used === "en-XA" ? pseudoLocale(english) : { ...english, ...draft };
  language = `${used}-u-nu-latn`;
  plurals = new Intl.PluralRules(language);
  document.documentElement.lang = used;
}

/** @type {Map<string, Promise<Texts>>} */
const catalogues = new Map();

/** Load the texts of a language, those of the master for one without a catalogue; each is fetched once. */
export function loadTexts(tag) {
  const name = LANGUAGES[tag]?.draft ? tag : "en";
  if (!catalogues.has(name)) catalogues.set(name, fetchTexts(name));
  return /** @type {Promise<Texts>} */ (catalogues.get(name));
}

const ACCENTS = { a: "á", e: "é", i: "í", o: "ó", u: "ú", A: "Á", E: "É", I: "Í", O: "Ó", U: "Ú", n: "ñ", c: "ç" };

/** @param {Texts} master */
function pseudoLocale(master) {
  const lengthen = (text) => {
    const accented = text.replace(/\{\{\w+\}\}|[a-zA-Z]/g, (part) => ACCENTS[part] ?? part);
    return `[${accented}${" one two three four five six seven".slice(0, Math.round(text.length * 0.4))}]`;
  };
  return Object.fromEntries(Object.entries(master).map(([key, text]) => [key, lengthen(text)]));
}

/** Return the text of `key`, in the plural form of `count`; undefined without one. */
const found = (table, key, count) => table[`${key}_${plurals.select(count)}`] ?? table[`${key}_other`] ?? table[key];

/** Return the text of `key` with {{names}} replaced; `vars.count` selects the plural form. */
export function t(key, vars = {}) {
  const text = found(texts, key, vars.count);
  if (text === undefined) throw new Error(`no words for ${key}`);
  return text.replace(/\{\{(\w+)\}\}/g, (_, name) => String(vars[name]));
}

/** Return whether `key` has a text and `vars` has every value that it needs. */
export function has(key, vars = {}) {
  const text = english[`${key}_other`] ?? english[key];
  if (text === undefined) return false;
  return [...text.matchAll(/\{\{(\w+)\}\}/g)].every(([, name]) => vars[name] !== undefined && vars[name] !== null);
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
