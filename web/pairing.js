// Controller of the pairing page: its texts, and the link to the page of the exam.

import { loadLanguage, t } from "./i18n/translate.js";

/** @type {<Kind extends HTMLElement>(selector: string) => Kind[]} */
const all = (selector) => [...document.querySelectorAll(selector)];

await loadLanguage(navigator.language.split("-")[0]);
for (const element of all("[data-text]")) element.textContent = t(element.dataset.text);
// The set-up code of the label stays in the fragment, which no browser sends.
for (const link of all("a#open")) link.href = `https://${location.hostname}:${link.dataset.port}/${location.hash}`;
for (const system of all("details")) system.open = new RegExp(system.dataset.agent).test(navigator.userAgent);
for (const main of all("main")) main.hidden = false;
