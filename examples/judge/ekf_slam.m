% EKF-SLAM for the draws of a robot with velocities and a sensor of relative positions at its pose, as
% those of the worlds `circle` and `loop`, in GNU Octave. The state x is the robot's pose (x, y, theta),
% then (x, y) of each landmark in the order in which they are first measured; P is its covariance.
% Numbers in brackets are of J. Solà, "Simultaneous localization and mapping with the extended Kalman
% filter", 2014.
%
%     octave-cli --norc -q ekf_slam.m draws/runs/0000 estimates/0000
1;  % a script, not a file of functions

function rows = read_table (file, header)
  id = fopen (file);
  if (id < 0 || ! strcmp (fgetl (id), header))
    error ("%s: expected %s", file, header);
  end
  fclose (id);
  rows = dlmread (file, ",", 1, 0);
end

function value = setting (run, section, key)  % the list of a key, as a column
  text = fileread (fullfile (run, "dataset.toml"));
  list = regexp (text, ['\[' section '\]\n(?:[^\[].*\n)*?' key ' = \[(.*)\]'], "tokens", "once", "dotexceptnewline");
  if (isempty (list))
    error ("%s/dataset.toml: expected a list %s in [%s]", run, key, section);
  end
  value = sscanf (list{1}, "%f,");
end

function save_table (file, header, rows)
  id = fopen (file, "w");
  if (id < 0)
    error ("%s: cannot be written", file);
  end
  fprintf (id, "%s\n", header);
  fprintf (id, [strjoin(repmat ({"%.17g"}, 1, columns (rows)), ",") "\n"], rows');
  fclose (id);
end

if (numel (argv ()) != 2)
  error ("usage: ekf_slam.m RUN ESTIMATE");
end
[run, estimate] = argv (){:};
odometry = read_table (fullfile (run, "odometry.csv"), "t [s],v [m/s],omega [rad/s]");
measured = read_table (fullfile (run, "measurements.csv"), "t [s],tag,ahead [m],left [m]");
Q = diag (setting (run, "motion", "noise") .^ 2);
R = diag (setting (run, "sensor", "noise") .^ 2);
x = setting (run, "filter", "start");
P = diag (setting (run, "filter", "start_noise") .^ 2);
tags = [];  % of the landmarks in x
steps = rows (odometry) - 1;
trajectory = zeros (steps, 10);
innovations = zeros (0, 9);

for k = 1:steps
  % Predict (14)-(17): the velocities of a row hold until the next.
  t = odometry(k + 1, 1);  dt = t - odometry(k, 1);  v = odometry(k, 2);  omega = odometry(k, 3);
  c = cos (x(3));  s = sin (x(3));
  F = eye (numel (x));
  F(1:3, 1:3) = [1, 0, -v * dt * s; 0, 1, v * dt * c; 0, 0, 1];
  G = zeros (numel (x), 2);
  G(1:3, :) = dt * [c, 0; s, 0; 0, 1];
  x(1:3) += dt * [v * c; v * s; omega];
  P = F * P * F' + G * Q * G';

  % Correct (26)-(30) by all landmarks of the scan that are in the map: z = Rot' (l - p).
  scan = measured(measured(:, 1) == t, 2:4);
  [is_known, place] = ismember (scan(:, 1), tags);
  Rot = [cos(x(3)), -sin(x(3)); sin(x(3)), cos(x(3))];
  H = zeros (0, numel (x));
  nu = [];
  for i = find (is_known)'
    l = 2 + 2 * place(i) + [0, 1];
    z_hat = Rot' * (x(l) - x(1:2));
    H_i = zeros (2, numel (x));
    H_i(:, 1:3) = [-Rot', [z_hat(2); -z_hat(1)]];
    H_i(:, l) = Rot';
    H = [H; H_i];
    nu = [nu; scan(i, 2:3)' - z_hat];
  end
  if (any (is_known))
    S = H * P * H' + kron (eye (sum (is_known)), R);
    L = chol (S, "lower");
    W = L \ (H * P);  % K nu = W' (L \ nu), K S K' = W' W
    white = L \ nu;
    x += W' * white;
    P -= W' * W;
    % The NIS of a number, and its log-likelihood, given those before it in the scan.
    nis = white .^ 2;
    log_likelihood = -(nis + log (2 * pi * diag (L) .^ 2)) / 2;
    for j = 1:sum (is_known)
      of_j = 2 * j - 1 : 2 * j;
      tag = scan(is_known, 1)(j);
      S_j = S(of_j, of_j);
      innovations(end + 1, :) = [t, tag, nu(of_j)', S_j([1, 3, 4]), sum(nis(of_j)), sum(log_likelihood(of_j))];
    end
  end

  % New landmarks (31)-(38): l = p + Rot z.
  Rot = [cos(x(3)), -sin(x(3)); sin(x(3)), cos(x(3))];
  for i = find (! is_known)'
    offset = Rot * scan(i, 2:3)';
    J = zeros (2, numel (x));
    J(:, 1:3) = [eye(2), [-offset(2); offset(1)]];
    P = [P, P * J'; J * P, J * P * J' + Rot * R * Rot'];
    x = [x; x(1:2) + offset];
    tags(end + 1) = scan(i, 1);
  end
  x(3) = atan2 (sin (x(3)), cos (x(3)));
  trajectory(k, :) = [t, x(1:3)', P(1, 1:3), P(2, 2:3), P(3, 3)];
end

map = zeros (0, 6);
for i = 1:numel (tags)
  l = 2 + 2 * i + [0, 1];
  map(i, :) = [tags(i), x(l)', P(l(1), l), P(l(2), l(2))];
end
save_table (fullfile (estimate, "trajectory.csv"), "time,x,y,theta,c_xx,c_xy,c_xt,c_yy,c_yt,c_tt", trajectory);
save_table (fullfile (estimate, "map.csv"), "landmark,x,y,c_xx,c_xy,c_yy", map);
save_table (fullfile (estimate, "innovations.csv"), "t,tag,nu_1,nu_2,s_11,s_12,s_22,nis,log_likelihood", innovations);
