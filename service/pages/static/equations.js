// What a model is: its description, its equations as MathML, its source.

import { makeElement } from './live.js';

const place = document.getElementById('about-model');

/** Make the element of an equation. The server makes the MathML from the checked model. */
const makeMath = (mathml) => document.importNode(new DOMParser().parseFromString(mathml, 'application/xml').documentElement, true);

/** Show title, equations, description and source of a model. */
export function describeModel(model, equations) {
  const list = Object.assign(makeElement('div', '', 'equations'), { role: 'group', ariaLabel: 'Equations', tabIndex: 0 });
  for (const { mathml } of equations) {
    list.append(document.createElement('div'));
    list.lastChild.append(makeMath(mathml));
  }
  const parts = [makeElement('b', model.title ?? model.name ?? ''), list];
  if (model.description) parts.push(makeElement('p', model.description, 'muted'));
  if (model.source) parts.push(makeElement('p', `Source: ${model.source}`, 'muted'));
  place.replaceChildren(...parts);
}
