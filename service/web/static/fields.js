// What all forms share: the table of bounds, submission, problem documents beside the fields they are about.

import { Problem, element, post } from './live.js';

const COLUMNS = ['lower', 'upper', 'fixed'];
const rows = document.getElementById('parameters');

/** One row per parameter of the model, with the bounds of the model or those that were asked for. */
export function fillTable(model, changes) {
  const made = Object.entries(model.parameters ?? {}).map(([name, known]) => {
    const row = document.createElement('tr');
    row.append(element('th', name));
    for (const column of COLUMNS) {
      const input = document.createElement('input');
      input.inputMode = 'decimal';
      input.ariaLabel = `${column} of ${name}`;
      input.dataset.parameter = name;
      input.dataset.column = column;
      input.dataset.pointer = `/parameters/${name}/${column}`;
      input.dataset.known = known?.[column] ?? '';
      input.value = changes[name]?.[column] ?? input.dataset.known;
      row.append(document.createElement('td'));
      row.lastChild.append(input);
    }
    row.append(element('td', known?.unit ?? '–', 'muted'));
    return row;
  });
  rows.replaceChildren(...made);
}

/** What differs from the model, as the job body wants it. */
export function overrides() {
  const found = {};
  for (const input of rows.querySelectorAll('input')) {
    const text = input.value.trim();
    if (text === '' || text === input.dataset.known) continue;
    const value = Number.isNaN(Number(text)) ? text : Number(text);
    (found[input.dataset.parameter] ??= {})[input.dataset.column] = value;
  }
  return found;
}

/** Put every fault beside the field that its pointer names, or the nearest above it. */
export function showFaults(form, problem) {
  const top = form.querySelector('#form-fault');
  problem.errors.forEach((fault) => beside(form, fault));
  const summary = problem.errors.length ? 'The request cannot be used:' : problem.document.title;
  top.replaceChildren(element('b', summary));
  const list = document.createElement('ul');
  const texts = problem.errors.length ? problem.errors.map(said) : [problem.message];
  texts.forEach((text) => list.append(element('li', text)));
  top.append(list);
  top.hidden = false;
  (form.querySelector('[aria-invalid="true"]') ?? top).focus();
}

const said = ({ pointer, detail, column }) =>
  `${pointer ? `${pointer}: ` : ''}${detail}${column ? ` (column ${column})` : ''}`;

function beside(form, fault) {
  const parts = (fault.pointer ?? '').split('/');
  for (; parts.length > 1; parts.pop()) {
    const pointer = parts.join('/');
    const input = form.querySelector(`:is(input, select, textarea)[data-pointer="${CSS.escape(pointer)}"]`);
    const place = form.querySelector(`[data-fault="/${CSS.escape(parts[1])}"]`);
    if (input) input.ariaInvalid = 'true';
    if ((input || parts.length === 2) && place) {
      place.textContent = [place.textContent, said(fault)].filter(Boolean).join('; ');
      return true;
    }
  }
  return false;
}

export function clearFaults(form) {
  form.querySelectorAll('.fault[data-fault]').forEach((one) => (one.textContent = ''));
  form.querySelectorAll('[aria-invalid]').forEach((one) => one.removeAttribute('aria-invalid'));
  form.querySelector('#form-fault').hidden = true;
}

/** What the form is about to do, or why it does not. */
export const say = (form, text) => (form.querySelector('#form-state').textContent = text);

/** Send the body that `make` gives when a form that is ready is submitted; faults go to their fields. */
export function submits(form, url, make, isReady = async () => true) {
  form.addEventListener('submit', async (event) => {
    event.preventDefault();
    clearFaults(form);
    const button = form.querySelector('[type="submit"]');
    button.disabled = true;
    say(form, 'submitting…');
    try {
      if (!(await isReady())) {
        button.disabled = false;
        return;
      }
      const job = await post(url, make());
      location.assign(`/jobs/${encodeURIComponent(job.id)}`);
    } catch (error) {
      if (!(error instanceof Problem)) throw error;
      say(form, '');
      showFaults(form, error);
      button.disabled = false;
    }
  });
}

/** What a choice sets going may be refused; the refusal is shown, never lost. */
export const shown = (form, work) => async (...given) => {
  try {
    await work(...given);
  } catch (error) {
    if (!(error instanceof Problem)) throw error;
    showFaults(form, error);
  }
};
