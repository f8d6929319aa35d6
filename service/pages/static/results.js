// Results across jobs: the figure, and rows that are ticked to be compared.

import './lists.js';
import { start } from './figures.js';

start();
