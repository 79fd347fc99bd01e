// Controller of the pairing page: its texts, and the link to the page of the exam.

import { loadLanguage, t } from "./i18n/translate.js";

/** @type {NodeListOf<HTMLElement>} */
const withText = document.querySelectorAll("[data-text]");
const link = /** @type {HTMLAnchorElement} */ (document.querySelector("a#open"));
const main = /** @type {HTMLElement} */ (document.querySelector("main"));

await loadLanguage(navigator.language.split("-")[0]);
for (const element of withText) element.textContent = t(element.dataset.text);
// The set-up code of the label stays in the fragment, which no browser sends.
link.href = `https://${location.hostname}:${link.dataset.port}/${location.hash}`;
for (const system of document.querySelectorAll("details")) {
  system.open = new RegExp(system.dataset.agent ?? "").test(navigator.userAgent);
}
main.hidden = false;
